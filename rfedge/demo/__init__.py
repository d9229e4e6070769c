"""The main job: a vehicle, a link and a roadside server as processes, on two drives."""

from rfedge.demo.run import DemoRun, DemoSettings, run_demo

__all__ = ["DemoRun", "DemoSettings", "run_demo"]

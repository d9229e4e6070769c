"""The demo: a vehicle, a link and a roadside server as processes, on the two sample drives."""

from rfedge.demo.run import DemoRun, DemoSettings, run_demo

__all__ = ["DemoRun", "DemoSettings", "run_demo"]

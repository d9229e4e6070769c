"""The agent of a connected vehicle (CAV): it codes camera frames against renders and streams them.

Other packages import these modules and no others:

* ``cav_agent.vehicle`` and ``cav_agent.config``: run an agent in a Python program;
* ``cav_agent.pipeline``: code a picture as an agent does;
* ``cav_agent.pose_feed``: read a pose feed as an agent does;
* ``cav_agent.field_fetch``: fetch a field from a server;
* ``cav_agent.metrics``: the metrics of an agent, for their reference.

A simulation may drive ``cav_agent.session`` and ``cav_agent.capture_schedule`` with the values of
``cav_agent.frames`` on a clock of its own.
"""

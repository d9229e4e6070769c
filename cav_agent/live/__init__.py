"""Cameras that send now: V4L2, RTSP, RTP, and video files played at their own speed.

``settings`` says what is opened, ``reader`` decodes it in a process of its own, ``source`` keeps
that process going and keeps its newest frame and time of capture. ``cav_agent.live_cameras`` poses
the frames of a vehicle's cameras and has them coded together.
"""

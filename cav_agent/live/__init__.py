"""Cameras that send now: V4L2, RTSP, RTP, and video files played at their own speed.

``address`` says what is meant, ``reader`` decodes it in a process of its own, ``source`` keeps that
process going and its newest frame, ``clock`` says when a frame was taken, ``camera`` poses it and
has it coded, and ``rig`` has several of them coded together.
"""

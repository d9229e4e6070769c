"""The agent of a connected vehicle (CAV): it codes camera frames against renders and streams them.

Other packages use these modules only:

* ``vehicle`` and ``config``: ``Vehicle``, which runs an agent in a program, and its settings;
* ``pipeline``: coding of a picture as an agent does it, for load tests;
* ``pose_feed``: poses of a feed as an agent reads them;
* ``field_fetch``: a field fetched from a server;
* ``session``, ``rate_control``, ``capture_schedule`` and ``frames``: a vehicle simulated on another
  clock.

The others may change without notice.
"""

"""Poses from where vehicles have them: GNSS receivers, gpsd, a line of JSON a pose.

``sources`` moves lines, ``reader`` turns a line into a ``Fix``, ``checks`` says what is wrong with
it, ``placing`` puts it into a field's axes as a ``PoseMeasurement`` of the camera, ``feed`` joins
them. All but ``sources`` are machines without sockets and clock. Import from the modules.
"""

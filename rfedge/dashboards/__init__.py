"""Grafana dashboards as a description in Python, and the JSON made of it.

    python -m rfedge.dashboards deploy/grafana/dashboards

``grafana`` is what a dashboard is made of and writes it as Grafana wants it; ``catalogue`` (fleet,
vehicle, server) and ``catalogue_link`` (link, codec) say what there is.
"""

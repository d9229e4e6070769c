"""Grafana dashboards as a description in Python, and the JSON made of it.

    python -m rfedge.dashboards deploy/grafana/dashboards

``panel`` is what a dashboard is made of, ``catalogue`` and ``catalogue_link`` say what there is,
``grafana`` writes it as Grafana wants it.
"""

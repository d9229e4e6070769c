"""Settings of every test: a slow or busy machine changes no verdict."""

from hypothesis import HealthCheck, settings

settings.register_profile("rfedge", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("rfedge")

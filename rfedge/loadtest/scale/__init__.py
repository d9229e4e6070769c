"""Several servers behind Envoy: run as processes, and measured against bounds."""

"""The digital twin: the newest picture of every camera, and the service consumers watch it by."""

"""A throughput-limited link between a real vehicle and a real server, as a TCP proxy."""

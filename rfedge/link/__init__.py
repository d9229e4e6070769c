"""The throughput-limited link as a TCP proxy between a real vehicle and a real server."""

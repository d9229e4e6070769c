"""A throughput-limited link as a machine without clock or socket.

``rfcore.link.shaper`` is the machine; ``rfcore.link.plan`` says what a link is made of, reads that
from a file and runs it on a virtual clock. The driver on real sockets is ``rfedge.link.proxy``.
"""

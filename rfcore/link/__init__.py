"""A throughput-limited link as a machine without clock or socket.

``rfcore.link.shaper`` is the machine; ``rfcore.link.plan`` says what a link is made of, reads that
from a file and runs it on a virtual clock. The driver on real sockets is ``rfedge.link.proxy``.
Impairments are imported only by a profile that names one.
"""

from rfcore.link.plan import Arrival, DirectionPlan, LinkPlan, delivery_times, read_link
from rfcore.link.shaper import Delivery, Link, LinkProfile

__all__ = [
    "Arrival",
    "Delivery",
    "DirectionPlan",
    "Link",
    "LinkPlan",
    "LinkProfile",
    "delivery_times",
    "read_link",
]

"""A throughput-limited link as a machine without clock or socket.

``profile`` and ``plan`` say what a link is, ``shaper`` is the machine, ``plan.delivery_times``
drives it on a virtual clock, ``profile_file`` reads a link from a file. The driver on real sockets
is ``rfedge.link.proxy``. Impairments are separate modules that only a profile naming them imports.
"""

from rfcore.link.plan import Arrival, DirectionPlan, LinkPlan, delivery_times
from rfcore.link.profile import LinkProfile
from rfcore.link.shaper import Delivery, Link

__all__ = [
    "Arrival",
    "Delivery",
    "DirectionPlan",
    "Link",
    "LinkPlan",
    "LinkProfile",
    "delivery_times",
]

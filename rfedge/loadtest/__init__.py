"""Load tests: how many vehicles, each on its own link, a server carries.

``run`` starts the processes: a server, the links, and the vehicles. Prerecorded vehicles
(``fleet``) replay packets that were coded once, so that the machine's time goes to the server. Live
vehicles are ``cav-agent`` processes. The latency of a picture is counted from the moment it was due
until its Ack arrives, even if the pictures before it were late (no coordinated omission).
"""

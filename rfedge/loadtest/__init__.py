"""How many vehicles a server carries: prerecorded or live ones, each on its own link.

``run`` starts the processes: a server, the links, and the fleet. Prerecorded vehicles (``fleet``)
replay packets that were coded once, so that the machine's time goes to the server; live ones are
``cav-agent`` processes. Latency is counted from the moment a picture was due, whatever became of
those before it (no coordinated omission), until its Ack arrives.
"""

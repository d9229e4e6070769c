"""How many vehicles a server carries: canned or live ones, each on its own link.

``run`` starts the processes: a server, the links, and the fleet. Canned vehicles (``fleet``) replay
packets that were coded once, so that the machine's time goes to the server; live ones are
``cav-agent`` processes. A picture counts from the moment it was due, whatever became of those
before it (no coordinated omission), until its Ack arrives: reconstruction and the way back.
"""

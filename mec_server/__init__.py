"""The edge server: reconstructs what vehicles see, against the radiance fields that it holds.

Other packages use these modules only:

* ``server``: ``EdgeServer``, which a program may embed, and ``serve``, which runs until a signal;
* ``config``: the settings of a server;
* ``decoding.decoders``: H.264 decoders in processes of their own or in sandboxes;
* ``reconstruction`` and ``session``: the decoders of a stream, for load tests that replace them;
* ``event_loop`` and ``ledger``: turns at workers, budgets and promises, for a simulated server;
* ``nats``: the connection to NATS, for consumers of one twin of several servers.

The others may change without notice.
"""

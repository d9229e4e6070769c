"""H.264 decoders of the server: in its own process, in processes of their own, or in sandboxes."""

"""The delta codec: camera frames as H.264 P slices against a render that is never sent.

``rfcore.codec`` is what both ends share: packets, states, references as pictures, and the receiver
(``decoder``). ``rfcore.codec.h264`` is the standard beneath: bitstream, parameter sets, I_PCM
pictures, our slice coder, x264 and FFmpeg. ``rfcore.codec.sender`` is what only the sender needs:
the encoder, the choice of references, rate control. Import from the modules; nothing is
re-exported.
"""

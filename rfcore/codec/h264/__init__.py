"""H.264 as the delta codec needs it: bitstream, parameter sets, I_PCM pictures, x264, FFmpeg."""

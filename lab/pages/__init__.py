"""Pages of recorded results, made of their files and never typed."""

"""Tools for fields as files: import, slimming, checking against a drive, looking at one."""

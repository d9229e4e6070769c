"""Certificates of one deployment: an authority and those it vouches for."""

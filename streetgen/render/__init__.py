"""Render a world with Mitsuba 3 and Open Image Denoise; no other package imports either."""

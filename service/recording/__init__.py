"""Recordings of sessions, written beside the frames and never in their way."""

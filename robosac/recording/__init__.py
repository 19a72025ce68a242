"""Recordings: a session's frames in MCAP files, written as they are decided and read back."""

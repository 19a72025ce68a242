"""Who is in a session and may speak, what waits there, how it begins and ends."""

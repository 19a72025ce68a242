"""Training of the embedded detector on generated scenes."""

"""What comes in: bounded, read once its sender is known, checked."""

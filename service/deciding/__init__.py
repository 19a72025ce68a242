"""From the messages of a frame to its answer, and how many frames are taken on."""

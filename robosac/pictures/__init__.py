"""What a defence does, drawn: a frame, a sequence with and without it, suspicion over time.

Colours are those of M. Okabe and K. Ito (Color Universal Design, 2008), which the colour-blind can tell apart. What has
a colour has a line style or a shape of its own, too.
"""

"""What can be done with recordings: decisions made again, and other forms of what is in them."""

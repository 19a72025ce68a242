"""What people may watch of the decisions as they are made: kept for a while, and told to whoever looks."""

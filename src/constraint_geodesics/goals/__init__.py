"""What a query asks to reach, a kind a file."""

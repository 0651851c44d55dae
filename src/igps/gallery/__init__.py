"""Collections that are asked again and again: indexed, searched, and freed of duplicates."""

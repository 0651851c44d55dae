"""Collections that are asked again and again: kept, searched, and freed of duplicates."""

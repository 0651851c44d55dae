"""What takes many descriptors or many bodies, as functions that return data."""

"""Statistical analyses of a collection, as functions that return data."""

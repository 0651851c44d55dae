"""Pictures and tables of what the studies found."""

"""Pictures and tables of what the studies found. Pictures need matplotlib: pip install "interior-gps[plot]"."""

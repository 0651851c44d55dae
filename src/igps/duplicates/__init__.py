"""Files that show the same body: copies, graded, and the meaning of distances."""

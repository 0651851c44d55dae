"""Training on a folder of labelled meshes, and how the model `pretrained` was made: see README.md."""

"""Fields: how their bodies come in, and what they know inside. A field is a folder that holds all it needs."""

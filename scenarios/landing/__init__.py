"""A helicopter, or a lander, that looks for a place to land in two pictures (Johnson, Montgomery & Matthies)."""

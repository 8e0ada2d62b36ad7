"""A helicopter, or a lander, that selects a landing site in two images (Johnson, Montgomery & Matthies)."""

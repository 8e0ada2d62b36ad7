"""A helicopter, or a lander, that selects a landing site in two images.

The paper, its sections, figures and tables, is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

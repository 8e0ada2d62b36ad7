"""Reports of visual target tracking: the paper's tables and figures next to those of Marsyard."""

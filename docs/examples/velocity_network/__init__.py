"""A velocity estimator with a neural network, its training, and its execution in batches; see the tutorial."""

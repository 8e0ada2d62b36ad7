"""The command line: one module per group of commands; `app` joins them."""

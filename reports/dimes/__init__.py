"""Reports of DIMES: its cases, its velocity errors, and the landing that uses its answer."""

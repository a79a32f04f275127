"""Run a scene many times with other values of its keys, and gather the outcomes in a table."""

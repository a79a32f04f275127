"""Hard cases of the node, which runs as a separate process and is driven over DDS."""

"""Hard cases of the node: it runs as a process of its own, and is spoken to over DDS."""

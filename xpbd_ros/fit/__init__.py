"""Find the values of a scene's keys with which the simulation explains a recorded point cloud."""

"""Write the states of a log for other programs, one format per file; memory stays bounded."""

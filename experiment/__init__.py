"""Everything around the algorithm: run folders, files, progress, figures and devices. Nothing in here learns."""

"""Everything around the algorithm: arguments, files, progress, figures, devices, gaits. Nothing in here learns."""

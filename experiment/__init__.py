"""What a run does around the algorithm: its folder, files, progress, figures and devices. Nothing in here learns."""

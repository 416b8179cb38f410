"""Files: scans and labels in, images and depths out."""

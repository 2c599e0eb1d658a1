"""Points in images: found (`sift`) and followed (`klt`)."""

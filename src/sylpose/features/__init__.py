"""Points in images: found (SIFT) and followed (KLT)."""

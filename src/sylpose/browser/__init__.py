"""Pages in the browser: the 3D viewer, the live view and the page on which boxes are drawn."""

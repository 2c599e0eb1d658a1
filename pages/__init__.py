"""Build the documentation as a site: generated pages, notebooks, the gallery."""

"""The documentation as a site: pages that are made, the notebooks, the gallery, and all of them put together."""

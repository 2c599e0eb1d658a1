"""Relative pose of a rigid object between two frames: six unknowns, perspective cameras, outliers.

A search on second moments (`moments_cost`, `search`) finds candidate minima; re-weighted least squares on the matches
(`match_cost`, `irls`) refines them and selects one. The public interface is `motion`.
"""

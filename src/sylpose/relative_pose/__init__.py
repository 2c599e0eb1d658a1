"""How an object moved between two frames: the paper's question in perspective, with six unknowns and outliers.

A first look from moments (`moments_cost`, `search`), the last word match by match (`match_cost`, `reweight`); `motion` is
its front.
"""

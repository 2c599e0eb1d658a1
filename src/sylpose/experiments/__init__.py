"""The paper's experiments: seeded Monte Carlo studies, each a table and a figure."""

from sylpose.experiments import accuracy, distributed, robustness, timing
from sylpose.experiments.study import Study
from sylpose.experiments.table import Table

__all__ = ["STUDIES", "Study", "Table"]

# In the order in which they are run: the times last, when all else is loaded.
STUDIES: tuple[Study, ...] = (
    *accuracy.STUDIES,
    *robustness.STUDIES,
    *distributed.STUDIES,
    *timing.STUDIES,
)

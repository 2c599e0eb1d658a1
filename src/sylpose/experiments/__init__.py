"""The paper's experiments: seeded Monte Carlo studies, each with a table and a figure."""

from sylpose.experiments import accuracy, distributed, timing
from sylpose.experiments.study import Study, Table

__all__ = ["STUDIES", "Study", "Table"]

# In the order of execution: run times last, when all modules are loaded.
STUDIES: tuple[Study, ...] = (*accuracy.STUDIES, *distributed.STUDIES, *timing.STUDIES)

"""What the commands do, for Python as well: `run` tracks a session, `check` looks for what is wrong with one, `demo` makes
a recording with known truth. `aloud`, `notes` and `text` are how they speak on a terminal; `sylpose.cli` ties them to their
options.
"""

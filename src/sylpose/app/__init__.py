"""Implementations of the commands, for use from Python as well; `sylpose.cli` defines their options.

`run` tracks a session, `check` validates one, `demo` renders a recording with ground truth. `console`,
`console_output` and `progress` write to the terminal.
"""

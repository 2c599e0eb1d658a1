"""Commands, for use from Python as well; `sylpose.cli` defines their options."""

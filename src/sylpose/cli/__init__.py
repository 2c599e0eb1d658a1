"""Options of the commands that have no options record yet."""

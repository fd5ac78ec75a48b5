"""Pure mathematics: arrays and numbers in, arrays and records out; no files, no screen."""

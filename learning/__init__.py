"""Models of a car's dynamics that are learned from recordings. Importing the package imports no array library."""

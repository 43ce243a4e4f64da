"""The result in the form in which a controller or a program takes it."""

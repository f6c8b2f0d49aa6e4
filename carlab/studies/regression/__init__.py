"""Regression study: methods fitted to few rows and scored on held-out rows."""

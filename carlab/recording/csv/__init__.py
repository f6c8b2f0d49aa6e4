"""CSV files: import of foreign layouts, and export."""

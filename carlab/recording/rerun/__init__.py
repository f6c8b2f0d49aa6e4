"""rerun recordings: entities, layout, writer, learning curve, screenshot."""

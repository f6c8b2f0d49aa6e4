"""The report of a diagnosis: JSON, HTML, rerun recording, picture and model.toml."""

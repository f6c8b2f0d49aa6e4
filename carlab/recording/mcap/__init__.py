"""MCAP files: schemas, messages, writer and reader."""

"""Networks and their training: particles as one tensor, normalisation, Adam."""

"""Episodes, policies and campaigns."""

"""The version of carlab, written to recordings and runs."""

VERSION = "0.1.0"

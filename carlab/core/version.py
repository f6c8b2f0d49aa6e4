"""The version of carlab, which recordings and runs name."""

VERSION = "0.1.0"

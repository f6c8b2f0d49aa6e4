"""The paper's algorithm: functional SVGD (FSVGD, and Sim-FSVGD with a simulator prior), and the authors' settings."""

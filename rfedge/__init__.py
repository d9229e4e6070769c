"""The workbench: commands that train, code, measure and demonstrate, on top of the two services."""

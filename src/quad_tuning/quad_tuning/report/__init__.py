"""Pictures of a gain design. The only place of the design that draws and writes files."""

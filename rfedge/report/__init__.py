"""The parts of reports and generated pages: charts, figures on disk, tables."""

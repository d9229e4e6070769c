"""What reports and generated pages are made of: charts, figures on disk, Markdown tables."""

"""Pages of ``docs`` that are generated from result files and declarations, never typed."""

"""From a BOP dataset and result files to the error table."""

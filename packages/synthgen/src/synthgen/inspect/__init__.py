"""Looking at what is there: a dataset's card, its samples, this machine."""

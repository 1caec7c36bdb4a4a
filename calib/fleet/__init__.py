"""Many rigs, or many cases of a study, on many processes: what each is, how it is run, what became of it."""

# qtm-rt 3.1.0: the part that is used here.

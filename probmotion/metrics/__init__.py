"""One file per question: how far are these draws from the truth?"""

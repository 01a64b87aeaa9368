"""A study with people: its plan, its trials, its statistics (`share study`).

plan            who meets which condition when, by letters; the key to the letters
orders          orders of conditions, balanced for place and carry-over
spots           where participants call the robot
trials          what a trial leaves behind, and whether the robot came
observations    the table that is analysed, from trials or from a CSV file
rank_tests      Friedman, Wilcoxon, Holm, Nemenyi
repeated_anova  repeated-measures ANOVA, crossover model, power
study_analysis  all tests of all measures
study_report    these as text, HTML, CSV, LaTeX
"""

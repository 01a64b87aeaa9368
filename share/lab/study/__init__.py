"""A study with people: its plan, its trials, its statistics (`share study`).

    plan            who meets which condition when, by letters; the key to the letters
    orders          orders of conditions, balanced for place and carry-over
    spots           where participants call the robot
    trials          what a trial leaves behind, and whether the robot came
    observations    the table that is analysed, from trials or from a CSV file
    rank_tests      Friedman, Wilcoxon, Holm, Nemenyi, preferences
    repeated_anova  repeated-measures ANOVA, order effects
    resampling      intervals over participants
    power           of the next study
    study_analysis  all tests of all measures
    study_tables    these as tables of text
    study_figures   and as pictures
    study_report    HTML, CSV, LaTeX

Letters become policies in `plan` and `observations`; all else knows conditions by the names that it is given.
"""

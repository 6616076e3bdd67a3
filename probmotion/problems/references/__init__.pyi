from .making import ReferenceRefused as ReferenceRefused, make_reference as make_reference
from .outlier_gibbs import OutlierGibbs as OutlierGibbs
from .store import find_reference as find_reference, references_folder as references_folder

"""Why a picture is as it is: what was prepared for it, as a page to look at."""

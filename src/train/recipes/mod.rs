//! Published trainings by name, as parts of a configuration.

use crate::error::{Error, Result};

/// The names, and what each says, as TOML.
const RECIPES: [(&str, &str); 2] =
    [("monovit", include_str!("monovit.toml")), ("monodepth2", include_str!("monodepth2.toml"))];

/// The recipe of a name. Its `unset` lists fields that it takes away from the defaults.
///
/// # Errors
/// If there is none of that name: those that there are.
pub(super) fn named(name: &str) -> Result<toml::Table> {
    let Some((_, text)) = RECIPES.iter().find(|(known, _)| *known == name) else {
        let known: Vec<&str> = RECIPES.iter().map(|(name, _)| *name).collect();
        return Err(Error::setting("recipe", format!("{name} is none of {}", known.join(", "))));
    };
    toml::from_str(text).map_err(|e| Error::Failed(format!("the recipe {name}: {e}")))
}

//! Kernels compiled once, here, for both element types: a program that uses the crate calls them, however it is built.
//!
//! The compiler makes a generic function where it is called. In a user's debug build that would be every kernel again,
//! without optimisation. [`Float`] has two types only, so a generic function can be a choice between two that exist.

use super::Float;

/// The type of a function for each element type.
pub trait Signature {
    /// A function pointer.
    type Of<T: Float>;
}

/// Defines a generic function whose two instances are compiled in this crate.
macro_rules! compiled {
    ($(#[$attribute:meta])* $vis:vis fn $name:ident<$T:ident>($($argument:ident: $type:ty),* $(,)?) $(-> $result:ty)? $body:block) => {
        $(#[$attribute])*
        $vis fn $name<$T: $crate::tensor::Float>($($argument: $type),*) $(-> $result)? {
            fn generic<$T: $crate::tensor::Float>($($argument: $type),*) $(-> $result)? $body
            struct Instance;
            impl $crate::tensor::Signature for Instance {
                type Of<$T: $crate::tensor::Float> = fn($($type),*) $(-> $result)?;
            }
            static SINGLE: <Instance as $crate::tensor::Signature>::Of<f32> = generic::<f32>;
            static DOUBLE: <Instance as $crate::tensor::Signature>::Of<f64> = generic::<f64>;
            $T::pick::<Instance>(SINGLE, DOUBLE)($($argument),*)
        }
    };
}

pub(crate) use compiled;
